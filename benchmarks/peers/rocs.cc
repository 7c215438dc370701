// The car of examples/car/carAbst.cpp, solved by ROCS 2, whose root is on the include path:
//   rocs FILE AUTOMATON DISTANCE DISTANCE DISTANCE
// with a file such as dba1.txt there. FILE gets a byte per cell, 1 where it wins from the automaton's first state on, 2 where it is an
// obstacle, and 0 elsewhere. Cells count with the first state fastest. Printed after `result`: cells, inputs, transitions, winning cells,
// CPU seconds of the abstraction and of the game, and the largest resident memory until then in KiB. The game is as there: the cells
// that its controller has in any state of the automaton are more than those that win from the first one.

#include <cmath>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

#include <sys/resource.h>

#include "src/DBAparser.h"
#include "src/abstraction.hpp"
#include "src/bsolver.hpp"

#include "examples/car/car.hpp"

namespace {

double seconds() {
  rusage usage;
  getrusage(RUSAGE_SELF, &usage);
  return usage.ru_utime.tv_sec + usage.ru_stime.tv_sec + 1e-6 * (usage.ru_utime.tv_usec + usage.ru_stime.tv_usec);
}

// Largest resident memory in KiB. What getrusage says begins with that of the process which started this one.
long memory() {
  std::ifstream status("/proc/self/status");
  for (std::string word; status >> word;)
    if (word == "VmHWM:") {
      long value = 0;
      status >> value;
      return value;
    }
  return -1;
}

}  // namespace

int main(int count, char** given) {
  if (count != 6) {
    std::cerr << "rocs: FILE AUTOMATON DISTANCE DISTANCE DISTANCE" << std::endl;
    return 2;
  }
  const double eta[] = {std::atof(given[3]), std::atof(given[4]), std::atof(given[5])};
  const double low[] = {0, 0, -3.5}, high[] = {10, 10, 3.5}, least[] = {-1, -1}, most[] = {1, 1}, step[] = {0.3, 0.3};
  const double start = seconds();
  rocs::DTCntlSys<carde> car("reach goal", h, carde::n, carde::m);
  car.init_workspace(low, high);
  car.init_inputset(step, least, most);
  rocs::abstraction<rocs::DTCntlSys<carde>> cells(&car);
  cells.init_state(eta, low, high);

  const double walls[4][4] = {{1.6, 5.7, 4, 5}, {3, 5, 5, 8}, {4.3, 5.7, 1.8, 4}, {5.7, 8.5, 1.8, 2.5}};
  const double regions[3][4] = {{1, 2, 0.5, 2}, {0.5, 2.5, 7.5, 8.5}, {7.1, 9.1, 4.6, 6.4}};
  std::vector<double> x(3);
  cells.assign_labels([&](std::size_t i) {
    cells._x.id_to_val(x, i);
    const double a = eta[0] / 2 + 1e-10, b = eta[1] / 2 + 1e-10;
    for (const auto& w : walls)
      if (w[0] - a <= x[0] && x[0] <= w[1] + a && w[2] - b <= x[1] && x[1] <= w[3] + b) return -1;
    return 0;
  });
  const double none[] = {0, 0, 0};
  cells.assign_transitions(none, none);
  const std::size_t transitions = cells._ts._ntrans;
  cells.assign_labels([&](std::size_t i) {
    cells._x.id_to_val(x, i);
    const double a = eta[0] / 2, b = eta[1] / 2;
    int letter = 0;
    for (const auto& r : regions)
      letter = 2 * letter + (r[0] <= x[0] - a && x[0] + a <= r[1] && r[2] <= x[1] - b && x[1] + b <= r[3]);
    return letter;
  });
  const double middle = seconds();

  rocs::UintSmall propositions = 0, nodes = 0, first = 0;
  std::vector<rocs::UintSmall> accepting;
  std::vector<std::vector<rocs::UintSmall>> after;
  if (!rocs::read_spec(given[2], nodes, propositions, first, after, accepting)) return 1;
  rocs::BSolver solver;
  solver.construct_dba(propositions, nodes, first, accepting, after);
  solver.load_abstraction(cells);
  solver.generate_product(cells);
  solver.solve_buchigame_on_product();
  const double end = seconds();
  const long peak = memory();

  std::vector<char> bytes(cells._x._nv);
  for (std::size_t i = 0; i < bytes.size(); i++) bytes[i] = cells._labels[i] < 0 ? 2 : 0;
  std::size_t number = 0;
  const HEAD& made = solver._sol;
  const SCOPE* scope = made.nts_product.scope;
  for (long long k = 0; k < made.nts_product.w0_1; k++) {
    scope += scope->next;
    bytes.at(made.decode1[made.decode2[scope->x] / made.dba.n]) = 1;
    number++;
  }
  std::ofstream(given[1], std::ios::binary).write(bytes.data(), bytes.size());
  std::cout << "result " << cells._x._nv << " " << car._ugrid._nv << " " << transitions << " " << number << " " << middle - start << " "
            << end - middle << " " << peak << std::endl;
}
