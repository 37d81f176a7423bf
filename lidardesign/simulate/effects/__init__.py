"""The optional effects, one module each.

A module has `why_absent` (the reason why the effect can change nothing), `bound` (what it could change at most, an
`EffectBound` of `first_hits`) and its simulation. `simulate.plan` adds the bounds up and decides; `simulate.returns`
runs what is on.
"""
