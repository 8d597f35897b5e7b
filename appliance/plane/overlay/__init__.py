"""The ring when not every gateway knows every other: bounded views, lookups hop by hop, upkeep. Pure.

To about a thousand gateways everybody knows everybody (`membership`), and a lookup is one hop. Beyond that each keeps
a bounded `view.View`: the members next to it on the ring, fingers at growing distances, some at random. A
`lookup.Lookup` asks its way to a key's owner; `upkeep.Upkeep` joins, keeps the view in step and mends it after
failures; `moves` tells which keys go where when the ring changes. Clock and randomness are passed in: the same code
runs under property tests and in the simulation of 10,000 gateways (`swiftbot bench dht`). No gateway runs it: members
beyond `membership.MOST` are refused.

Sources: Stoica et al., "Chord", SIGCOMM 2001 and IEEE/ACM ToN 11(1), 2003 (ring, successor list, greedy lookup,
stabilisation); Manku et al., "Symphony", USITS 2003 (distances of the long links); Gupta et al., "One hop lookups for
peer-to-peer overlays", HotOS 2003 (the view known whole).
"""
