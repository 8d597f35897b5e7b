"""Identity of members: the fleet's authority, certificates and their roles, the roster of those issued and revoked.

Doors: `authority.Authority` (issues, renews and revokes), `bundle.Bundle` (what one process has: its private key, its
certificate and the authority's), `roster` (the signed list), `member` (what a certificate says, and who signed a
request), `signing` (requests), `parts` (the signed list of what may be fetched, loaded and run).

A fleet has one authority. Its private key signs a certificate for each gateway, robot, recorder and person, and the
roster: the list of certificates with what became of them. Every holder of the authority's certificate can check both
without asking anybody, so gateways need no server that is always there.
"""
