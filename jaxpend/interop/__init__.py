"""Doors to other libraries, one file each; nothing else in the package needs them."""
