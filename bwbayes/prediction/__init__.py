"""From a posterior to displacement bands for any voltage, their scores, and loop and step measures."""
