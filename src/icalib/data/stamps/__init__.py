"""Checks of timestamps: unit, order, duplicates, clock jumps; time windows."""
