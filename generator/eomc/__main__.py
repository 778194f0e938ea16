"""python -m eomc."""

from eomc.cli.main import main

main()
