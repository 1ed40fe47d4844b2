"""Writers of simulated recordings: messages in bags, and tables."""
