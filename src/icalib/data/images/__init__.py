"""Images of recordings, and videos."""
