"""`python -m lidardesign`: the program."""

from lidardesign.cli.main import run

if __name__ == "__main__":
    run()
