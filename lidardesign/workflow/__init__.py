"""The application layer: what `import lidardesign` offers, as whole steps on runs and designs.

`runs` and `designs` are the nouns; `learn`, `fit`, `evaluate` and `export` resolve requests and run them; `fit_design`
fits and checks a design, whose rays `select_rays` may choose.
"""
