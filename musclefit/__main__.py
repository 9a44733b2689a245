"""``python -m musclefit``."""

from __future__ import annotations

import sys

from musclefit.cli import main

if __name__ == "__main__":
    sys.exit(main())
