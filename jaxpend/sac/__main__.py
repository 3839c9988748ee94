"""``python -m jaxpend.sac``: the same as ``jaxpend sac``."""

from ..cli.app import main

main("sac")
