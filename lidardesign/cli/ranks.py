"""Several processes that a launcher (`torchrun -m lidardesign learn ...`) started as one command.

The first one is the command: it reads the options, writes the run and prints. The others follow it, and speak only of
what the first one cannot know.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

import typer

from lidardesign.cli.output import EXIT_INTERRUPTED, Console
from lidardesign.errors import ConfigError, LidardesignError, LostRankError, ThresholdError
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from lidardesign.density.ranks import Ranks

# torchrun sets the first of these; it, mpirun wrappers and clusters set the others, which torch.distributed needs.
LAUNCHER = "TORCHELASTIC_RUN_ID"
NEEDED = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


def refuse_ranks(subcommand: str) -> None:
    """Refuse to run a command many times at once that does not know of ranks.

    Raises:
        ConfigError: torchrun started several; the first one says so.
    """
    if LAUNCHER not in os.environ or os.environ.get("WORLD_SIZE", "1") == "1":
        return
    if os.environ.get("RANK", "0") != "0":
        raise typer.Exit(ConfigError.exit_code)
    raise ConfigError(f"{subcommand} does not run on several ranks", where="torchrun", allowed="learn")


@contextlib.contextmanager
def joined_ranks(console: Console) -> Iterator[Ranks]:
    """The ranks of this command. The others than the first one follow it inside and leave the command here.

    Raises:
        LostRankError: Another rank ended, or cannot be reached.
    """
    if not all(name in os.environ for name in NEEDED):
        with phase("libraries"):
            from lidardesign.density.ranks import ALONE

        yield ALONE
        return
    with phase("libraries"):
        from lidardesign.density.rank_processes import finish, join_ranks
    with phase("ranks"):
        ranks = join_ranks()
    if not ranks.first:
        _follow(ranks, console)
        raise typer.Exit
    try:
        try:
            yield ranks
        except ThresholdError:  # all was learned; it is the user's tolerance that was missed
            finish(ranks)
            raise
        with contextlib.suppress(LostRankError):  # all is written: nothing is lost with a rank that ends now
            finish(ranks)
    except BaseException:
        ranks.tell()
        raise


def _follow(ranks: Ranks, console: Console) -> None:
    """Learn along; an error is told on stderr unless the first rank tells of it, or of its own."""
    from lidardesign.density.rank_processes import follow

    console.json, console.quiet = False, True
    try:
        follow(ranks)
    except KeyboardInterrupt:
        raise typer.Exit(EXIT_INTERRUPTED) from None
    except LidardesignError as error:
        if not ranks.is_told():
            print(f"rank {ranks.rank}: {error.kind} error: {error}", file=sys.stderr)
        raise typer.Exit(error.exit_code) from None
