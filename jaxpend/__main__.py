"""``python -m jaxpend``: the same as the command ``jaxpend``."""

from .cli.app import main

main()
