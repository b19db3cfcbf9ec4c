"""Campaigns: thousands of flights over drawn conditions, their failures classified and ranked."""
