"""Values that the paper gives in section IV, for reference marks: another testbed, real data, absolute times."""

TABLE = (
    ("GPT-4o", 94.3, 91.5, 1280.0),
    ("Claude 3.5", 93.1, 89.8, 1040.0),
    ("GPT-4o-mini", 88.2, 82.4, 450.0),
    ("Llama 3.1-70B", 85.6, 78.6, 680.0),
)
"""Table I: model, decomposition accuracy and parallelisation recall in percent, mean latency in ms."""
START_MS = {"cold": 650.0, "local": 180.0, "federated": 120.0}
"""Median startup by pool mode."""
P99_MS = {"cold": ((1.0, 850.0), (5.0, 920.0), (20.0, 1400.0)), "local": ((1.0, 220.0), (5.0, 420.0), (20.0, 1100.0)),
          "federated": ((1.0, 180.0), (5.0, 240.0), (20.0, 520.0))}  # fmt: skip
"""p99 of startup by pool mode: tasks a second, ms."""
ROUND_RATIO = {"clips": 0.40, "words": 0.50}
"""Round time against FedAvg's with 16 clients: UCF101, LibriSpeech."""
CLIENTS = (8, 16, 24, 32)
KILLED_AT = (2, 4, 8, 16)
"""Rounds in which clients fail."""
