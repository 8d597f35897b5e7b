"""Built-in skills: one folder a skill with manifest and handler, and the images they run in.

Doors: `catalogue` (skills and images, their manifests), `requirements` (Python packages of an image), `sites` (what
place names mean), `_lib.coordinates` (coordinates in words, read alike by plans and handlers), `_lib.paths` (ways round
obstacles, alike in handlers, estimates and on the shared floor), `_lib.learning` (data sets and what learns from them,
alike here and in handlers).

The handlers and the rest of `_lib` run in containers and are imported by nothing here.
"""
