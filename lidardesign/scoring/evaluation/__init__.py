"""What a design is worth on held-out scenes, against the rivals an engineer would build.

In reading order: `request` says what is asked for; `score` lays out designs and rivals (`baselines`, `cma`);
`scene_scores` hands rays and returns to the task, which scores them with the distances of `metrics`; `results` and
`statistics` make rows and intervals; `figures` and `report` show them. `accuracy` measures what numerical settings cost
in time.
"""
