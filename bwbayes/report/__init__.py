"""Reports of products, which are shown on a screen, as a page and in files."""
