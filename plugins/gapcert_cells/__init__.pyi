from gapcert_cells.automaton_controller import AutomatonController as AutomatonController
from gapcert_cells.files import loaded as loaded
from gapcert_cells.files import loading as loading
from gapcert_cells.files import saved_data as saved_data
from gapcert_cells.files import write_saved as write_saved
from gapcert_cells.grid_controller import GridController as GridController
from gapcert_cells.hoa import read_hoa as read_hoa
from gapcert_cells.load import load_controller as load_controller
from gapcert_cells.ltl import automaton_of as automaton_of
from gapcert_cells.outside import inside_alone as inside_alone, refusal as refusal
from gapcert_cells.successors import GROWTH as GROWTH, SEEN as SEEN
from gapcert_cells.successors import Along as Along
from gapcert_cells.successors import Splits as Splits
from gapcert_cells.successors import Successors as Successors
from gapcert_cells.successors import SuccessorsByLevel as SuccessorsByLevel
