"""Tasks on screen: the list, one task with the graph of its plan, one subtask with its reasons; and plans under review.

`facts` makes rows and sentences, `reasons` tells why something waits; both are pure. `screen`, `graph`, `review` and
`submit` show them.
"""
