"""Mixtures of sensors, fitted by expectation maximisation inside bounds.

From constraints to a fitted gate, in reading order: `bounds` turns a sensor's rules into arrays (`_gate_bounds`: start,
end and width of its gate); `components` holds the samples and has the E-step, `expect`; `m_step.maximise` is the
M-step, where `fit_gate` keeps those bounds, `fit_field` those of the field of view and `origin_step` those of the
origin; `em` repeats both from several seeds; `ensemble` fits groups of sensors that stand at different places.
"""
