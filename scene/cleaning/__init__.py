"""From a registered cloud to the returns of one bore: finds its axis, and cuts away what is not the bore."""
