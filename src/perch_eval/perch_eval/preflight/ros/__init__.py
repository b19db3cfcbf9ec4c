"""What listens to the graph."""
