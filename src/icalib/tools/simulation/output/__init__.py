"""How simulated recordings are written: messages in bags, and tables."""
