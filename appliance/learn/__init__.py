"""Federated learning on top of tasks: models are trained over the fleet, round by round, with no gateway in charge.

Pure: `recipe` (what a run is to be, from one TOML file), `rounds` (what the coordinator of a round decides), `records`
(keys, and which version stands after a partition), `decisions` (steps of rounds for the log, and made again from it),
`status` (what clients are at, rounds in numbers), `tables` (how runs are read), `export` (a model's files).

On each gateway: `manager` (answers for runs, takes up the rounds that are its own), `round_driver` (coordinates one).

`datasets` makes and checks data. What is computed lies in `appliance.skills._lib.learning`, alike for gateways and
containers; `workshop.simulators.learning` plays the decider over thousands of clients.
"""
