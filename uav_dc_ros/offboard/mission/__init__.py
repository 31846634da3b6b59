"""The bridge's decisions, from preflight to landing. Every part works on telemetry and time alone."""
