// Requests to the server. Addresses are relative to that of the page, which holds the token.

export class Refused extends Error {}

export async function ask(name, query = {}, signal = undefined) {
  const answer = await fetch(address(name, query), { signal });
  if (!answer.ok) throw new Refused(await reason(answer));
  return answer;
}

export async function asked(name, query = {}, signal = undefined) {
  return (await ask(name, query, signal)).json();
}

export function address(name, query = {}) {
  const pairs = Object.entries(query).flatMap(([key, value]) =>
    [value].flat().filter((each) => each !== undefined && each !== null).map((each) => [key, each]),
  );
  const text = new URLSearchParams(pairs).toString();
  return `api/${name}${text ? `?${text}` : ""}`;
}

async function reason(answer) {
  try {
    return (await answer.json()).error;
  } catch {
    return `The server answered ${answer.status}.`;
  }
}
