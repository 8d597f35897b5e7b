"""MAVLink through a gateway: a real vehicle's log played through the router, and tasks over a bad link."""
