"""Long work, of which only the newest matters."""

import threading

from subterra_jax.viewer.config import ViewerError
from subterra_jax.viewer.player import Worker


def test_the_newest_job_makes_the_one_under_way_stale_and_those_between_are_never_begun():
    done, began, go, finished = [], threading.Event(), threading.Event(), threading.Event()
    worker = Worker(done.append)

    def first(stale):
        began.set()
        go.wait(10.0)
        done.append(("first", stale()))

    def last(stale):
        done.append(("last", stale()))
        finished.set()

    worker.submit(first)
    assert began.wait(10.0)
    worker.submit(lambda stale: done.append("between"))
    worker.submit(last)
    go.set()
    assert finished.wait(10.0)
    worker.stop()
    assert done == [("first", True), ("last", False)]


def test_a_job_that_fails_is_told_in_a_sentence_and_the_next_is_done():
    said, told, finished = [], threading.Event(), threading.Event()

    def report_error(sentence):
        said.append(sentence)
        told.set()

    def failing(error):
        def job(stale):
            raise error

        return job

    worker = Worker(report_error)
    for error in (ViewerError("no such thing"), KeyError("seed")):
        told.clear()
        worker.submit(failing(error))
        assert told.wait(10.0)
    worker.submit(lambda stale: finished.set())
    assert finished.wait(10.0)
    worker.stop()
    assert said == ["no such thing", "KeyError: 'seed'"]
