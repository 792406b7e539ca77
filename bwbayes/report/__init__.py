"""Reports: what a product says, once, and how it is shown on a screen, as a page and in files."""
