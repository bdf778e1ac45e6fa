"""The evaluation of the Stanford-ORB data set: its protocol and its table."""
