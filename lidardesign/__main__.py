"""`lidardesign` and `python -m lidardesign`: the program."""

import signal


def run() -> None:
    """Run the program on the arguments of the process."""
    # imports may swallow the exception of a Ctrl-C, but not the death by its signal
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from lidardesign.cli.main import run as run_program

    run_program()


if __name__ == "__main__":
    run()
