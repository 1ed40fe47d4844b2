"""Images of a recording, worked on by all cores; results kept on disk."""
