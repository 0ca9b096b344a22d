"""`python -m zlocus`, the same as the command."""

from zlocus.cli import app

if __name__ == "__main__":
    app()
