"""Time stamps: clocks, jumps, gaps, copies."""
