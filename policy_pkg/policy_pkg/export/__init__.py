"""Policies for elsewhere: a folder of a model and a description of what goes in and out."""
