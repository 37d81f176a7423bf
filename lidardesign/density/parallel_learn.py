"""What the ranks after the first do: whatever the first one announces, until it says that all is done.

Only the first rank knows the command line and the run folder. It announces every ground that it prepares and every
training that it starts (`Ranks.announce`), with the configuration: the others need neither its files nor its options.
"""

from __future__ import annotations

import json
from pathlib import Path

from lidardesign.density.ground import Ground, prepare_ground
from lidardesign.density.learn import learn
from lidardesign.density.parallel import Ranks
from lidardesign.run.config import config_of
from lidardesign.run.yaml import Document

# Named in the errors of a rank that has no folder.
NO_FOLDER = Path("the first rank's run")


def finish(ranks: Ranks) -> None:
    """Tell the others that nothing more comes, and part from them."""
    if ranks.size > 1:
        ranks.share(b"")
        ranks.leave()


def follow(ranks: Ranks) -> None:
    """Learn along with the first rank; writes and prints nothing."""
    ground: Ground | None = None
    while content := ranks.share(b""):
        job = json.loads(content)
        task, config = config_of(Document(job["config"], "the first rank's configuration"))
        if job["job"] == "ground":
            ground = prepare_ground(task, config, ranks)
        else:
            learn(
                task, config, NO_FOLDER, resume=job["resume"], device=job["device"], ground=ground, ranks=ranks
            )
    ranks.leave()
