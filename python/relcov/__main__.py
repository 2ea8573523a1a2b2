"""The ``relcov`` command."""

from __future__ import annotations

import signal
import sys

from ._relcov import run_command


def main() -> int:
    # Ctrl-C is the command's own affair: training saves, everything else ends at once.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return run_command(["relcov", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())
