"""``mo-deepdrive study`` from a checkout; the code is in algorithms/commands/study.py."""

import sys

from mo_deepdrive_command import run_script

if __name__ == "__main__":
    sys.exit(run_script("study"))
