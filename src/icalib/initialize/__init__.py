"""The initial guess of everything: where the solver starts."""
