"""A recorded log on the same screens: what was heard then is heard again, at any speed.

`record.playhead` decides which moment is shown, `cursor` reads the messages up to it, `source` takes them to the
screens in place of the plane; `times` has times and rates as people write them.
"""
