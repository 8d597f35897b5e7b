"""What handlers share. Mounted at `/skills/_lib`; a handler says `from _lib import paths`.

It runs inside containers: standard library only, except `colours`, which needs numpy and Pillow (image
`vision`), and `learning`, which needs numpy. Nothing of the appliance is imported here, since nothing of it is there.
"""
