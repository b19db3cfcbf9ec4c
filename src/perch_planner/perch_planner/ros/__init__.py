"""Messages of the planners, to their requests and from their plans."""
