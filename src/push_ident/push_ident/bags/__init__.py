"""Bags to and from the types of the package, without a ROS installation."""
