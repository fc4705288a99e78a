"""Whether a recorded run is a run of the model of its scenario (:func:`.explain.explains`)."""
