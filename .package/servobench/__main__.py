"""The command `servobench`, also as `python -m servobench`."""


def main() -> None:
    """Run the command, which is imported late: a worker process imports this module before it can end with it."""
    from servobench.harness.cli.main import main as command

    command()


if __name__ == "__main__":
    main()
