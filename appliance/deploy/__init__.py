"""How the program comes onto a machine: signed bundles, releases side by side, upgrade and rollback.

    /opt/swiftbot/releases/ID      one release: venv/, systemd/, docs/, LICENSE, release.json
    /opt/swiftbot/current          link to the one that runs; switched by a rename
    /opt/swiftbot/previous         link to the one before

Units, generator and command are links into `current`, so one rename switches all of them: after a power cut there is
the old release or the new one, whole.
"""
