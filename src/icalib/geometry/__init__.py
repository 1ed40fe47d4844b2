"""SO(3), camera models and targets."""
