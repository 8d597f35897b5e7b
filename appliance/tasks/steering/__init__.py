"""What operators order of tasks: approve, reject, pause, resume, retry, answer; and the audit of all their orders."""
