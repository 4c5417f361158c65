"""Training of learnt localisers: `python -m train.locate`."""
