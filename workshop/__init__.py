"""The workshop: what developers run and no gateway does. Benchmarks, simulators, a fleet on one machine, training.

It imports the product (`appliance`), never the other way round; its commands reach `swiftbot` by the entry point group
`swiftbot.commands` (`commands`).
"""
