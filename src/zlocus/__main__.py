"""The program: `zlocus`, and `python -m zlocus`."""

from zlocus.core.signals import handle_signals


def run() -> None:
    """Handle signals before anything else is imported, which takes a moment; then run the command line and exit."""
    handle_signals()
    from zlocus.cli.app import main

    main()


if __name__ == "__main__":
    run()
