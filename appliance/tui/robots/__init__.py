"""Robots on screen: where they are, one by one, and under an operator's hand.

`map` draws positions, `facts` makes rows and sentences, `holding` decides what a held key means; these are pure.
`screen` and `takeover` show them.
"""
