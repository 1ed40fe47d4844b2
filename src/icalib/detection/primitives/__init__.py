"""What targets consist of: edges, saddles, quads, tags, ellipses."""
