"""Steps that initial guesses of several kinds of sensors share."""
