"""Built-in skills: one folder a skill with manifest and handler, and the images they run in."""
