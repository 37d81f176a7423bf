"""One ladder per numerical choice: each module measures one, for a task and a run, on this machine."""
