"""What a C file of a controller with a memory has beside the tables: the memory's own functions."""

from __future__ import annotations

DECLARED = """\
/* The controller has a memory, a number that the caller keeps, and reads every state of a run once:

     int memory;
     controller_init(&memory);
     each period:  code = controller_step(x, CONTROLLER_FIRST, &memory, u);

   The goal is reached, and the promise ends, where controller_done(memory). */
#define CONTROLLER_MEMORIES {memories}

/* Before a run has begun. */
void controller_init(int *memory);

/* The memory reads x; CONTROLLER_OUTSIDE where the goal is lost, and the memory is as it was then. */
int controller_advance(const double x[CONTROLLER_STATES], int *memory);

/* controller_advance and controller_act in one; where there is no input, the memory is as it was. */
int controller_step(const double x[CONTROLLER_STATES], int policy, int *memory, double u[CONTROLLER_INPUTS]);

/* 1 where the goal is reached. */
int controller_done(int memory);

"""

SOURCE = """
/* a times b, rounded before anything is added to it. */
static double times(double a, double b) {
  volatile double product = a * b;
  return product;
}

static int in_shape(const double x[CONTROLLER_STATES], int k) {
  double y[CONTROLLER_STATES], d[CONTROLLER_STATES];
  volatile double total;
  int i, j;
  for (j = 0; j < CONTROLLER_STATES; j++) {
    y[j] = is_angle[j] ? turned(x[j], shape_box[k][j][0], shape_box[k][j][1], shape_box[k][j][2]) : x[j];
    if (!(y[j] >= shape_box[k][j][0] && y[j] <= shape_box[k][j][1])) return 0;
    d[j] = y[j] - shape_centres[k][j];
  }
  for (i = 0; i < CUTS; i++) {
    if (cut_of[i] != k) continue;
    total = 0.0;
    for (j = 0; j < CONTROLLER_STATES; j++) total = total + times(cuts[i][j], y[j]);
    if (!(total <= bounds[i])) return 0;
  }
  total = 0.0;
  for (i = 0; i < TERMS; i++) {
    if (term_of[i] == k) total = total + times(times(d[terms[i][0]], d[terms[i][1]]), factors[i]);
  }
  return total <= 1.0;
}

void controller_init(int *memory) { *memory = MEMORY_START; }

int controller_done(int memory) { return memory >= 0 && memory < CONTROLLER_MEMORIES && is_done[memory]; }

int controller_advance(const double x[CONTROLLER_STATES], int *memory) {
  size_t cell;
  int k, letter = 0, next;
  if (*memory < 0 || *memory >= CONTROLLER_MEMORIES) return CONTROLLER_OUTSIDE;
  for (k = 0; k < SHAPES; k++) {
    if (in_shape(x, k)) letter |= 1 << shape_region[k];
  }
  /* What was proved of the whole cell counts, should a point on a border be told otherwise by rounding. */
  if (grid_cell(x, &cell) == CONTROLLER_OK) letter = (letter | must[cell]) & may[cell];
  next = after[*memory][letter];
  if (next < 0) return CONTROLLER_OUTSIDE;
  *memory = next;
  return CONTROLLER_OK;
}

int controller_step(const double x[CONTROLLER_STATES], int policy, int *memory, double u[CONTROLLER_INPUTS]) {
  int then = *memory, code = controller_advance(x, &then);
  if (code == CONTROLLER_OK) code = controller_act(x, then, policy, u);
  if (code == CONTROLLER_OK) *memory = then;
  return code;
}
"""
