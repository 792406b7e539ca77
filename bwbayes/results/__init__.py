"""What a posterior is good for: displacement bands, and whether they turn out right."""
