"""Tests that state the promises of bwbayes, folder by folder as in the package."""
