"""The scenarios that come with this package."""
