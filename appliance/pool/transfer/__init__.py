"""Volumes and images that move between gateways: in chunks over Zenoh, checked, compressed, resumable.

Doors:
    transfers.Transfers       bring a volume or an image here; serve ours to others; what it costs

Inside: protocol (what is moved and asked for, how fast; pure), source (gives), target (fetches), archive (a volume as a
tar file). Settings: `TransferConfig` of `pool.settings`.
"""
