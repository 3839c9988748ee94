"""``python -m jaxpend``: the same as the command ``jaxpend``."""

from .cli import main

main()
