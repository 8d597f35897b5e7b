"""Histories of concurrent clients of the replicated records under failure, and what they prove, after Jepsen."""
