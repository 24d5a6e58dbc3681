"""The running service under load, faults and attacks."""
