"""`semstab-bench` and `python -m semstab`: the command line, where Ctrl-C is one line from the first import on."""

import os
import signal
import sys


def _end(*_: object) -> None:
    """End the process at once: nothing is begun yet, or all is done; an exception would come out of an import."""
    sys.stderr.write("interrupted\n")
    os._exit(130)


def main() -> None:
    """Run the command line; the entry point of the console script."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    from semstab.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()
