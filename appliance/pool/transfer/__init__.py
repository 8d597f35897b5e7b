"""Volumes and images that move between gateways: in chunks over Zenoh, checked, compressed, resumable.

Doors:
    transfers.Transfers       bring a volume or an image here; serve ours to others; what it costs
    settings.TransferConfig   table `transfer` of section `[pool]`
"""
