"""Python reads this before any program where `small_runs.shifting_environment` puts it on the path."""

import os
import sys

if sys.argv[1:2] == ["learn"] and "--seed" not in sys.argv:
    sys.argv += ["--seed", os.environ["SMALL_RUN_SEED_SHIFT"]]
