"""Data sets: stand-ins that are made here, and the check of a folder before anything is trained on it.

    make.py       writes a stand-in into a folder, with progress; begun again, it goes on where it was
    clips.py      draws action clips: people, vehicles, drones, an arm, on sites with their own light and background
    speech.py     what is said: words and sentences, with the voices, rooms and noise of speakers
    avi.py, flac.py   the two file formats, as plain as they may be
    check.py      what a folder holds, for `swiftbot learn data check`

Stand-ins are laid out as UCF101 and LibriSpeech are (`appliance.skills._lib.learning.ucf101`, `librispeech`), so that
real data are trained on by naming their folder instead.
"""
