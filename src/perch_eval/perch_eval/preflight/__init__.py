"""Is a vehicle ready to fly: what its graph brings is judged against the vehicle file, with the props off."""
