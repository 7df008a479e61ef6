"""``mo-deepdrive sweep`` from a checkout; the code is in algorithms/commands/sweep.py."""

import sys

from mo_deepdrive_command import main

if __name__ == "__main__":
    sys.exit(main("sweep"))
