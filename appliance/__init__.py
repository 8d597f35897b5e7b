"""SwiftBot gateway: an edge appliance that turns instructions to a robot fleet into work on warm containers.

Rooms, lowest first: `model` and `errors` (words everybody shares), `plane` (Zenoh, DHT), `skills`
(catalogue), `llm`, `pool`, `robots`, `record` (which know nothing of each other), `tasks`, `learn`, `client`
(what a person's command does), `tui`, and on top `gateway` and `cli`. Imports go downward only; import-linter
enforces it.
"""
