"""Put a fitted model to work: inverse, compensation, closed loop, and code for a controller."""
