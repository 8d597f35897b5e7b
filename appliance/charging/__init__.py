"""Robots that have little charge and nothing to do go to a charger by themselves: `tasks.battery.auto_charge`.

`decide` says which robot goes where (pure); `keeper` looks at the fleet and submits the tasks, on the gateway that owns
the key `charging`.

Doors: `keeper.Charging`.
"""
