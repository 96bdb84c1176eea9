"""``python -m elpd`` is ``elpd``."""

from elpd.cli import main

main()
