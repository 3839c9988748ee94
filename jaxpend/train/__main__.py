"""``python -m jaxpend.train``: the same as ``jaxpend train``."""

from ..cli.app import main

main("train")
