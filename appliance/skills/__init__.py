"""Built-in skills: one folder a skill with manifest and handler, and the images they run in.

Doors: `catalogue.load_catalogue` (skills and images), `catalogue.image_reference` (an image's name with its hash),
`sites.load_site` (what place names mean). The handlers and `_lib` run in containers and are imported by nothing here.
"""
