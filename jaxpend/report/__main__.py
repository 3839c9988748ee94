"""``python -m jaxpend.report``: the same as ``jaxpend report``."""

from ..cli.app import main

main("report")
