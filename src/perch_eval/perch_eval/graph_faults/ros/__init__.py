"""What the campaign of faults sees of the graph."""
