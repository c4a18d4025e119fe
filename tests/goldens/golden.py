"""Golden answers: what placegraph answered before code moved, and must answer after.

    python tests/goldens/golden.py --check [group ...]
    python tests/goldens/golden.py --write [group ...]

writes or checks `<group>.json`; without a group all of them. Whoever changes a figure on purpose
writes them again, in a commit of its own that says why.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from time import perf_counter, process_time

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import golden_indoor  # noqa: E402
import golden_outdoor  # noqa: E402
from golden_answers import differences, plain, read, write  # noqa: E402
from golden_worlds import Worlds  # noqa: E402

GROUPS = golden_outdoor.GROUPS | golden_indoor.GROUPS
FAST = ("town", "few")
"""Groups that every run of the tests compares."""


def answered(group, worlds):
    """Answers of a group, by question."""
    return {name: plain(answer) for name, answer in GROUPS[group](worlds)}


def compared(group, worlds):
    """Where the answers of a group differ from those that are kept, in words."""
    return list(differences(read(HERE / f"{group}.json"), answered(group, worlds), group))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--write", action="store_true")
    what.add_argument("--check", action="store_true")
    parser.add_argument("groups", nargs="*", default=list(GROUPS))
    given = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as folder:
        worlds = Worlds(folder)
        for group in given.groups:
            start, used = perf_counter(), process_time()
            if given.write:
                answers = answered(group, worlds)
                write(HERE / f"{group}.json", answers)
                outcome = f"{len(answers)} answers written"
            else:
                found = compared(group, worlds)
                failed |= bool(found)
                outcome = "\n  ".join([f"{len(found)} differences", *found[:20]])
            seconds = f"{perf_counter() - start:.1f} s, {process_time() - used:.1f} s of CPU"
            print(f"{group}: {seconds}: {outcome}", flush=True)  # noqa: T201
    sys.exit(failed)


if __name__ == "__main__":
    main()
