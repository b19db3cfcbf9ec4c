#!/usr/bin/env python3
"""Write docs/limits.md: sizes, counts, magnitudes and rates of everything that enters."""

from __future__ import annotations

import argparse
import sys

from perch_setup import ROOT, enter


def main() -> int:
    """Write the page."""
    argparse.ArgumentParser(description=__doc__, epilog="example:  python3 scripts/limits.py").parse_args()
    enter()
    from perch_eval.limits_page import main as write

    return write(ROOT)


if __name__ == "__main__":
    sys.exit(main())
