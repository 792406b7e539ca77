"""What a config may say: its keys, their types, defaults and descriptions, and how TOML is read."""
