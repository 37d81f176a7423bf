"""The choice of rays among many, and how far from the best it is.

In reading order: `proposals` draws candidate rays and `gates` gives each a few gates; `training_scenes` asks what they
tell about how many scenes (`are_enough`), and `coverage` gathers that as a table; `choice` takes rays, each with one of
its gates; `selection` does so for several numbers of rays, or with one gate per sensor (`_shared_gates`); `certificate`
bounds what any choice could gain.
"""
