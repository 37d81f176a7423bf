"""Designs: constrained mixtures of physical sensors, their rays and their files.

In reading order: `sensor` holds what a design is, `files` its YAML document; `constraints` the rules that it keeps and
the independent checker; `mixture` fits sensors by expectation maximisation; `layouts` turn sensors into rays; `fit`
goes from samples to a design. `catalog` holds real parts; `rigs` reads designs of others.
"""
