"""Live view: markers of a running flight, and the WebSocket server that shows them in Foxglove."""
