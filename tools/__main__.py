"""The entry point of `./dev`, for any Python 3.11 or newer, before anything is installed."""

import sys
from pathlib import Path


def main() -> int:
    """Run the command named on the command line; return the exit status."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
    from tools.commands import main as run

    return run(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
