"""From a posterior to displacement bands, their scores, and measures of loops and steps."""
