"""From nothing compiled to the end of the demo: ``python -m benchmarks.start``.

Prints the CPU and wall time to compile what the plane needs and all kernels, each into an empty cache; and those of
``graph_slam demo`` with an empty cache, and of a second one.
"""

import argparse
import tempfile

from benchmarks.replay import commanded


def main() -> None:
    """Measure, and print a line for each."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    with tempfile.TemporaryDirectory(prefix="start-") as folder:
        for what, cache, words in (
            ("compile the plane", "plane", ["warmup", "--dimensions", "2"]),
            ("compile all kernels", "all", ["warmup", "--dimensions", "3"]),
            ("demo, nothing compiled", "demo", ["demo", "--out", f"{folder}/first"]),
            ("demo once more", "demo", ["demo", "--out", f"{folder}/second"]),
        ):
            cpu_s, wall_s = commanded(words, GRAPH_SLAM_CACHE=f"{folder}/{cache}")
            print(f"{what}: {cpu_s:.1f} s of CPU, {wall_s:.1f} s", flush=True)


if __name__ == "__main__":
    main()
