"""What a gateway tells monitoring systems: metrics for Prometheus; metrics, traces and logs by OTLP. Off by default.

Doors: `settings.ObserveConfig`; `facts.Facts`, what its metrics are made of; `observer.Observer`, which alone imports
OpenTelemetry and is itself imported only where something is switched on.

Inside: figures (the table of metrics, pure), spans (transitions and run events in, spans out, pure). It asks nobody:
what it tells is what the gateway publishes anyway, handed over within the process.
"""
