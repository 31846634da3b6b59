"""Missions in bags of any recorder that has the topics: info, export, verification and report pages."""
