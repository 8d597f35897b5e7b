"""Robots: MAVLink endpoint and Zenoh robots, commands out, telemetry and tasks in, and who may command them.

Doors: `hub.RobotHub` (all robots of a gateway), `authority.authority` (stops and leases), `authority.soft_stop.Stops`,
`sender` (commands to a robot), `verbs` (what robots can be told), `limits` (what an order may ask), `settings`,
`task_listener.Tasks` (what robots may ask of tasks); `conformance` (tests a robot against the contract) and `qgc`
(buttons for QGroundControl) for the command line.

Inside: `executor` (each command at most once) serves robots of both kinds; `client` and `zenoh_client` are for robots
with a computer of their own; `retry` says when to ask again; `mavlink` is the endpoint, from `links` (bytes) over
`frame_router` to `vehicle_manager` and `companion`.
"""
