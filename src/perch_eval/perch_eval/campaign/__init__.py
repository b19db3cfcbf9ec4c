"""Campaigns: thousands of flights under randomised conditions, with failures classified and ranked."""
