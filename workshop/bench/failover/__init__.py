"""How fast a fleet is whole again: a gateway that is restarted (`restart`), a root that is lost (`takeover`)."""
