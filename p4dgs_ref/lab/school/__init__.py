"""Classroom mode: equations for students to write, a grader with held-back inputs, and the key.

A teacher's session in Python:

    from p4dgs_ref.lab import school
    school.classroom("course")  # writes course/student, to be handed out, and course/key
    grades = school.grade("anna", "ben", classroom="course")  # what two students handed in
    print(school.text(grades))  # the sums, and the points of every equation
    eq = school.load("course/student/offsets.py")  # the equation in a student's file
"""

from .grading import grade, text, write
from .room import ClassroomError, classroom
from .student import load

__all__ = ["ClassroomError", "classroom", "grade", "load", "text", "write"]
