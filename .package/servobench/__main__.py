"""`python -m servobench` is the command `servobench`."""

from servobench.harness.cli.main import main

main()
