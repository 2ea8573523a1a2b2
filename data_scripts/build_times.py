#!/usr/bin/env python3
"""The slowest packages of cold builds, side by side, as a Markdown table.

    cargo build --release --timings      # writes target/cargo-timings/cargo-timing.html
    data_scripts/build_times.py cargo-timing.html [another.html ...] [--rows 20]

Seconds are those that each package's steps took on the clock, beside whatever else was compiled then.
"""

import argparse
import json
import re
import sys
from collections import Counter
from pathlib import Path


def seconds_by_package(path):
    """Seconds of each package, its build script's run included."""
    found = re.search(r"const UNIT_DATA = (\[.*?\]);\n", Path(path).read_text(), re.S)
    if not found:
        sys.exit(f"{path}: found no UNIT_DATA; expected the page that cargo build --timings writes")
    seconds = Counter()
    for unit in json.loads(found[1]):
        seconds[unit["name"]] += unit["duration"]
    return seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", help="pages that cargo build --timings wrote")
    parser.add_argument("--rows", type=int, default=20, help="packages that are shown (default 20)")
    arguments = parser.parse_args()
    builds = [seconds_by_package(page) for page in arguments.pages]
    print("| package |" + "".join(f" {Path(page).stem}, s |" for page in arguments.pages))
    print("|---|" + "---|" * len(builds))
    # Those that lead any of the builds, as the first one orders them.
    leaders = {name for build in builds for name, _ in build.most_common(arguments.rows)}
    for name in sorted(leaders, key=lambda name: [-build[name] for build in builds]):
        print(f"| {name} |" + "".join(f" {build[name]:.1f} |" if name in build else " – |" for build in builds))
    print("| all |" + "".join(f" {build.total():.0f} |" for build in builds))


if __name__ == "__main__":
    main()
