"""The optional effects, one module each.

A module has `why_absent` (the reason why the effect changes nothing), `bound` (an upper bound of its effect, an
`EffectBound` of `first_hits`) and its simulation. `simulate.plan` adds the bounds up and decides; `simulate.returns`
simulates the chosen effects.
"""
