"""Interface between sensor kinds and the estimator: base class of every `sensors/KIND/model.py`, and its data."""
