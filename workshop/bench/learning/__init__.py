"""Federated learning against its promises: `swiftbot bench learn`.

Each measurement is a cell with a file of its own (`store`), so that a bench that was interrupted goes on where it was:

    virtual   rounds decided by the product's decider in virtual time, trained for real in containers (`virtual`)
    hostile   the same with clients that send what they should not (`hostile`)
    live      a fleet with a container for each client: devices emulated, gateways and clients killed (`live`)
    flower    the same model and data in Flower, simulated and deployed (`flower`)

`cells` lists them, `figures` holds what they show against what was demanded, and `run` puts it together.
"""
