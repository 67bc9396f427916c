"""Policies in ROS terms: their model, and SROS2 policy XML 0.2.0."""
