"""Long work, of which only the newest matters."""

import threading

from subterra_jax.viewer.errors import ViewerError
from subterra_jax.viewer.worker import Worker


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

    worker.do(first)
    assert began.wait(10.0)
    worker.do(lambda stale: done.append("between"))
    worker.do(last)
    go.set()
    assert finished.wait(10.0)
    worker.stop()
    assert done == [("first", True), ("last", False)]


def test_a_job_that_fails_is_told_in_a_sentence_and_the_next_is_done():
    said, told, finished = [], threading.Event(), threading.Event()

    def complain(sentence):
        said.append(sentence)
        told.set()

    def failing(error):
        def job(stale):
            raise error

        return job

    worker = Worker(complain)
    for error in (ViewerError("no such thing"), KeyError("seed")):
        told.clear()
        worker.do(failing(error))
        assert told.wait(10.0)
    worker.do(lambda stale: finished.set())
    assert finished.wait(10.0)
    worker.stop()
    assert said == ["no such thing", "KeyError: 'seed'"]
