"""Images and videos of recordings: reading, checks, decoding."""
